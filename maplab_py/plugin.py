"""Everything that a plugin needs of the console. A plugin is a module with commands::

    @command("count_landmarks", "cl", example="cl")
    def count_landmarks(context: CommandContext) -> Message:
        '''Count the landmarks of the selected map.'''
        return Message(f"{len(context.vi_map.landmarks)} landmarks")

named in the entry-point group ``maplab_py.plugins`` of its distribution. See
docs/writing_plugins.md, also for what of this is promised to stay.
"""

import importlib
from typing import TYPE_CHECKING, Any

from maplab_py.console.commands.command import command
from maplab_py.console.session.context import ALL_MISSIONS, CommandContext, MissionChoice
from maplab_py.console.session.importing import importer
from maplab_py.console.session.maps import key_of_folder
from maplab_py.errors import Cancelled, EstimationError, FlagError, MapError, MaplabError, UserError
from maplab_py.options import Options, option
from maplab_py.output_files import check_writable, write_bytes, write_text
from maplab_py.progress import Progress
from maplab_py.report import Message, Report

if TYPE_CHECKING:
    from maplab_py.estimation.terms.extension import ResidualRows, residual
    from maplab_py.viewer.extension import LayerLines, LayerPoints, viewer_layer
    from maplab_py.vimap import VIMap
    from maplab_py.vision.features.extension import ExtractedFeatures, feature_extractor

_IMPORTED_ON_USE = {
    "VIMap": "maplab_py.vimap",
    "ResidualRows": "maplab_py.estimation.terms.extension",
    "residual": "maplab_py.estimation.terms.extension",
    "LayerLines": "maplab_py.viewer.extension",
    "LayerPoints": "maplab_py.viewer.extension",
    "viewer_layer": "maplab_py.viewer.extension",
    "ExtractedFeatures": "maplab_py.vision.features.extension",
    "feature_extractor": "maplab_py.vision.features.extension",
}
"""Modules that commands without such a need, and `help`, do not wait for."""

API_VERSION = (1, 6)
"""Version of what this file exports: (breaking changes, additions)."""

__all__ = [
    "ALL_MISSIONS",
    "API_VERSION",
    "Cancelled",
    "CommandContext",
    "EstimationError",
    "ExtractedFeatures",
    "FlagError",
    "LayerLines",
    "LayerPoints",
    "MapError",
    "MaplabError",
    "Message",
    "MissionChoice",
    "Options",
    "Progress",
    "Report",
    "ResidualRows",
    "UserError",
    "VIMap",
    "check_writable",
    "command",
    "feature_extractor",
    "importer",
    "key_of_folder",
    "option",
    "residual",
    "viewer_layer",
    "write_bytes",
    "write_text",
]


def __getattr__(name: str) -> Any:
    """Import what few plugins need when it is asked for."""
    if name in _IMPORTED_ON_USE:
        return getattr(importlib.import_module(_IMPORTED_ON_USE[name]), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
