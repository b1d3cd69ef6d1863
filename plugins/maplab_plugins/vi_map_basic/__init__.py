"""maplab's vi_map_basic plugin: maps in memory and on disk, their content, undo."""

from maplab_plugins.vi_map_basic.cells import join_submaps, split_map
from maplab_plugins.vi_map_basic.history import history, redo, restore, snapshot, undo
from maplab_plugins.vi_map_basic.information import (
    check_map_consistency,
    map_stats,
    mission_coobservability_stats,
    print_baseframes,
    print_camera_calibrations,
)
from maplab_plugins.vi_map_basic.loading import (
    list_maps_on_file_system,
    load,
    load_all,
    load_merge_all_maps,
    load_merge_all_submaps,
    load_merge_map,
    load_merge_submap,
    recover,
)
from maplab_plugins.vi_map_basic.memory import (
    clear_storage,
    copy_map,
    create_new_map,
    delete_map,
    join_all_maps,
    list_maps,
    merge_map,
    rename_map,
    select_map,
)
from maplab_plugins.vi_map_basic.memory_report import memory
from maplab_plugins.vi_map_basic.resources import (
    clean_up_resource_folders,
    list_resource_folders,
    remove_resources,
    resource_cache_statistics,
    resource_statistics,
    use_external_resource_folder,
    use_map_resource_folder,
)
from maplab_plugins.vi_map_basic.saving import get_map_folder, save, save_all, set_map_folder
from maplab_plugins.vi_map_basic.why import why

__all__ = [
    "check_map_consistency",
    "clean_up_resource_folders",
    "clear_storage",
    "copy_map",
    "create_new_map",
    "delete_map",
    "get_map_folder",
    "history",
    "join_all_maps",
    "join_submaps",
    "list_maps",
    "list_maps_on_file_system",
    "list_resource_folders",
    "load",
    "load_all",
    "load_merge_all_maps",
    "load_merge_all_submaps",
    "load_merge_map",
    "load_merge_submap",
    "map_stats",
    "memory",
    "merge_map",
    "mission_coobservability_stats",
    "print_baseframes",
    "print_camera_calibrations",
    "recover",
    "redo",
    "remove_resources",
    "rename_map",
    "resource_cache_statistics",
    "resource_statistics",
    "restore",
    "save",
    "save_all",
    "select_map",
    "set_map_folder",
    "snapshot",
    "split_map",
    "undo",
    "use_external_resource_folder",
    "use_map_resource_folder",
    "why",
]
