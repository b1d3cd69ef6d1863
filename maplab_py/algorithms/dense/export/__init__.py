"""Export of images, poses and landmarks for programs of multi-view stereo."""
