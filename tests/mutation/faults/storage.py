"""Faults of reading and saving maps, and of writing other files."""

from tests.mutation.fault import Fault

_MAPS = ("tests/storage",)
_FIELDS = ("tests/storage/test_fields.py",)
_FAULTS = "tests/faults/test_faults.py::test_every_system_call_may_fail_or_be_the_last"
_REPLACED_MAP = (f"{_FAULTS}[replaced map]",)
_REPLACED_FILE = (f"{_FAULTS}[csv]",)
_LOCKS = ("tests/atomic/test_replacing.py",)
_ANY = "not browser"

STORAGE = (
    Fault(
        "old_folder_deleted_before_rename",
        "maplab_py/atomic/folders.py",
        '    aside = sibling(folder, "old")\n    folder.rename(aside)\n',
        '    aside = sibling(folder, "old")\n    shutil.rmtree(folder)\n',
        _REPLACED_MAP,
        _ANY,
    ),
    Fault(
        "old_folder_not_moved_back",
        "maplab_py/atomic/folders.py",
        "        aside.rename(folder)\n        flush_folder(folder.parent)\n",
        "        pass\n",
        _REPLACED_MAP,
        _ANY,
    ),
    Fault(
        "no_exchange_of_names",
        "maplab_py/atomic/system.py",
        '    if not sys.platform.startswith("linux"):\n',
        "    if sys.platform:\n",
        _REPLACED_MAP,
        _ANY,
    ),
    Fault(
        "map_not_flushed_to_disk",
        "maplab_py/atomic/folders.py",
        "                flush_tree(temporary, on_disk)\n",
        "",
        _REPLACED_MAP,
        _ANY,
    ),
    Fault(
        "output_file_not_flushed_to_disk",
        "maplab_py/atomic/files.py",
        "            os.fsync(self.stream.fileno())\n",
        "            self.stream.fileno()\n",
        _REPLACED_FILE,
    ),
    Fault(
        "checksums_not_verified",
        "maplab_py/storage/map_loading.py",
        "listed_files(folder, budget.max_bytes)\n    checksums.verify(folder, listed)\n",
        "listed_files(folder, budget.max_bytes)\n",
        _MAPS,
    ),
    Fault(
        "two_saves_at_a_time",
        "maplab_py/atomic/system.py",
        "                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)\n",
        "                fcntl.LOCK_EX\n",
        _LOCKS,
    ),
    Fault(
        "saves_in_progress_are_deleted",
        "maplab_py/atomic/folders.py",
        "                if has_lock:\n",
        "                if has_lock or folder:\n",
        _LOCKS,
    ),
    Fault(
        "plain_files_without_bound",
        "maplab_py/storage/protobuf/map_files.py",
        "        packed = read_file(path, max_bytes, error=MapError)\n",
        "        packed = read_file(path, 1 << 60, error=MapError)\n",
        _FIELDS,
    ),
    Fault(
        "cut_gzip_accepted",
        "maplab_py/input_files.py",
        "        content += piece\n    raise EOFError\n",
        "        content += piece\n    return content, len(data)\n",
        _MAPS,
    ),
    Fault(
        "listed_path_leaves_the_folder",
        "maplab_py/storage/protobuf/map_files.py",
        ' or ".." in relative.parts or',
        " or",
        _MAPS,
    ),
    Fault(
        "switch_variable_off_by_default",
        "maplab_py/storage/protobuf/tables_from_messages.py",
        'if e.HasField("switch_variable") else 1.0',
        'if e.HasField("switch_variable") else 0.0',
        _FIELDS,
    ),
    Fault(
        "switch_variance_not_written",
        "maplab_py/storage/protobuf/tables_to_messages.py",
        '        loop.switch_variable_variance = float(columns["loop.switch_variable_variance"][row])\n',
        "",
        _FIELDS,
    ),
    Fault(
        "observation_behind_the_frame",
        "maplab_py/storage/map_loading.py",
        "listed.keypoint_index < counts[frame]",
        "listed.keypoint_index <= counts[frame]",
        _FIELDS,
    ),
    Fault(
        "resources_lost_by_saving_over",
        "maplab_py/storage/map_saving.py",
        "        _keep(folder, temporary, on_disk)\n",
        "",
        _MAPS,
    ),
)
