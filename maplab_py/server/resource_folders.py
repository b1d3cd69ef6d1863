"""Resources of submaps in the folder of the server's map."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.storage.resources import MAP_FOLDER
from maplab_py.vimap import VIMap
from maplab_py.vimap.stacking import resource_folder_name


def with_resources_taken_in(whole: VIMap, submap: VIMap) -> VIMap:
    """Return a map whose own folder has the resources that were in a submap's own folder.

    Maps that are joined refer to the resource folder of the second one as to an external folder. The server
    brings the files of submaps to the folder of its map instead (`Publisher.with_resources`).

    Args:
        whole: The map, joined with the submap.
        submap: The submap.
    """
    folders = whole.metadata.external_resource_folders
    name = resource_folder_name(submap.metadata)
    if name not in folders:
        return whole
    index, folder = folders.index(name), whole.resources.folder
    left = folder - (folder > index).astype(folder.dtype)
    metadata = dataclasses.replace(
        whole.metadata, external_resource_folders=folders[:index] + folders[index + 1 :]
    )
    resources = whole.resources.replace(folder=np.where(folder == index, MAP_FOLDER, left))
    return whole.replace(resources=resources, metadata=metadata)
