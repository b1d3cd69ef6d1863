"""Faults of the console: lines, flags, maps, jobs, statuses."""

from tests.mutation.fault import Fault

_SETTINGS = ("tests/console/session/test_session.py",)
_JOBS = (
    "tests/console/session/test_maps.py",
    "tests/console/session/test_jobs.py",
)
_RUNNER = (
    "tests/console/scripts/test_runner.py",
    "tests/console/session/test_session.py",
)
_MAPS = (
    "tests/console/session/test_maps.py",
    "tests/console/session/test_session.py",
)
_LINES = (
    "tests/console/commands/test_registry.py",
    "tests/console/scripts/test_typed_lines.py",
)
_FLAGS = (
    "tests/console/commands/test_flags.py",
    "tests/console/session/test_session.py",
)
_BATCH = ("tests/console/scripts/test_runner.py",)

CONSOLE = (
    Fault(
        "lasting_flags_beat_typed_ones",
        "maplab_py/console/session/call.py",
        "        if name not in values:\n",
        "        if name in command.flags:\n",
        _SETTINGS,
    ),
    Fault(
        "cancelled_job_changes_the_maps",
        "maplab_py/console/session/jobs.py",
        "            if self.result is None or self.token.abandoned:\n",
        "            if self.result is None:\n",
        _JOBS,
    ),
    Fault(
        "user_errors_end_as_failures",
        "maplab_py/console/session/status.py",
        "    return Status.USER_ERROR if isinstance(error, UserError) else Status.FAILED\n",
        "    return Status.FAILED\n",
        _RUNNER,
    ),
    Fault(
        "conflicting_map_counts_as_saved",
        "maplab_py/console/session/maps.py",
        "entry, key=free, folder=None, saved=None, disk_copy=None",
        "entry, key=free",
        _JOBS,
    ),
    Fault(
        "history_without_limit",
        "maplab_py/console/session/maps.py",
        "        past = (*self.past, Step(command, self.vi_map))[-MAX_UNDO:]\n",
        "        past = (*self.past, Step(command, self.vi_map))\n",
        _MAPS,
    ),
    Fault(
        "redo_after_a_new_command",
        "maplab_py/console/session/maps.py",
        "vi_map=vi_map, past=past, future=())",
        "vi_map=vi_map, past=past)",
        _MAPS,
    ),
    Fault(
        "variables_in_single_quotes",
        "maplab_py/console/commands/lines.py",
        '        if character == "$" and lookup and quote != "\'" and',
        '        if character == "$" and lookup and',
        _LINES,
    ),
    Fault(
        "half_of_a_set_command_lasts",
        "maplab_py/console/session/settings.py",
        "        for setting in settings:\n            self._check(setting)\n",
        "",
        _SETTINGS,
    ),
    Fault(
        "included_flag_file_beside_the_shell",
        "maplab_py/console/commands/flags.py",
        "    return path if path.is_absolute() else including.parent / path\n",
        "    return path\n",
        _FLAGS,
    ),
    Fault(
        "dry_run_changes_the_maps",
        "maplab_py/console/session/session.py",
        "            return report, base\n",
        "            return report, draft.maps.state\n",
        _MAPS,
    ),
    Fault(
        "status_of_the_last_failure",
        "maplab_py/console/scripts/runner.py",
        "            first = first or status\n",
        "            first = status\n",
        _RUNNER,
    ),
    Fault(
        "blanks_in_batch_folders",
        "maplab_py/console/scripts/batch.py",
        ".replace(FOLDER_TEMPLATE, lines.escaped(folder))",
        ".replace(FOLDER_TEMPLATE, folder)",
        _BATCH,
    ),
)
