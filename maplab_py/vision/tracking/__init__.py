"""Tracks: keypoints followed from image to image and between the cameras of a rig.

`tracker.FrameTracker` works on images, `replay.tracked_images_of` on keypoints that are tracked
already; both return `tracks.TrackedImages`.
"""
