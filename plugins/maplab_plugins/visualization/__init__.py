"""maplab's visualisation plugin: the selected map in the browser, beside the console."""

from maplab_plugins.visualization import clouds, images, maps, meshes, output

__all__ = ["clouds", "images", "maps", "meshes", "output"]
