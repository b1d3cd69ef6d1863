"""The doctor of a recording: checks of its signals before anything is estimated from them."""
