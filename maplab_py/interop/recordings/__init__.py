"""Recordings of cameras and IMUs as one stream of events in the order of time.

`opening.open_recording` finds the reader of a folder or bag, `map_replay.MapRecording` replays a mission
of a map; `stream.EventStream` yields batches of IMU samples and synchronised frame sets.
"""
