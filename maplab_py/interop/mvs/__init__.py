"""File formats of programs of multi-view stereo: COLMAP's models, Bundler's, PMVS's."""
