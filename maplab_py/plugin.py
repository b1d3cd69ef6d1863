"""Everything that a plugin needs of the console. A plugin is a module with commands::

    @command("count_landmarks", "cl", example="cl")
    def count_landmarks(context: CommandContext) -> Message:
        '''Count the landmarks of the selected map.'''
        return Message(f"{len(context.vi_map.landmarks)} landmarks")

named in the entry-point group ``maplab_py.plugins`` of its distribution. See
docs/writing_plugins.md, also for what of this is promised to stay.
"""

from maplab_py.console.command import command
from maplab_py.console.context import CommandContext
from maplab_py.console.importing import importer
from maplab_py.console.maps import key_of_folder
from maplab_py.errors import Cancelled, EstimationError, FlagError, MapError, UserError
from maplab_py.estimation.extension import ResidualRows, residual
from maplab_py.options import option
from maplab_py.output_files import check_writable, write_bytes, write_text
from maplab_py.progress import Progress
from maplab_py.report import Message, Report
from maplab_py.viewer.extension import LayerLines, LayerPoints, viewer_layer
from maplab_py.vimap import VIMap

API_VERSION = (1, 2)
"""Version of what this file exports: (breaking changes, additions)."""

__all__ = [
    "API_VERSION",
    "Cancelled",
    "CommandContext",
    "EstimationError",
    "FlagError",
    "LayerLines",
    "LayerPoints",
    "MapError",
    "Message",
    "Progress",
    "Report",
    "ResidualRows",
    "UserError",
    "VIMap",
    "check_writable",
    "command",
    "importer",
    "key_of_folder",
    "option",
    "residual",
    "viewer_layer",
    "write_bytes",
    "write_text",
]
