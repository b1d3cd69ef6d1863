"""Everything that a plugin needs of the console. A plugin is a module with commands::

    @command("count_landmarks", "cl", example="cl")
    def count_landmarks(context: CommandContext) -> Message:
        '''Count the landmarks of the selected map.'''
        return Message(f"{len(context.vi_map.landmarks)} landmarks")

named in the entry-point group ``maplab_py.plugins`` of its distribution. See
docs/writing_plugins.md.
"""

from maplab_py.console.command import command
from maplab_py.console.context import CommandContext
from maplab_py.console.maps import key_of_folder
from maplab_py.errors import Cancelled, EstimationError, MapError, UserError
from maplab_py.options import option
from maplab_py.progress import Progress
from maplab_py.report import Message, Report

__all__ = [
    "Cancelled",
    "CommandContext",
    "EstimationError",
    "MapError",
    "Message",
    "Progress",
    "Report",
    "UserError",
    "command",
    "key_of_folder",
    "option",
]
