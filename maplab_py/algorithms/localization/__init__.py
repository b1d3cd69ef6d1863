"""Localisation: where in a map was an image taken?"""
