"""holod in Python: phase patterns for a pupil, what an eye sees of them, and the figures that judge them.

    import holod

    scene = holod.builtin_scene(512, 512)
    renderer = holod.Renderer(width_px=512, height_px=512)
    hologram = renderer.render(scene.rgb, scene.depth, 3.0, colour=scene.colour, depth_unit=scene.depth_unit)
    hologram.levels             # what the rig's panel is sent
    hologram.phase_rad          # the same as phases, for another panel
    hologram.view(2.5)          # what the eye sees that is focused at 2.5 dioptres (40 cm)

Levels are those of the daemon, bit for bit. `Rig` describes a bench, `view` looks at any phases, `evaluate` judges
weights, `load_scene` and `read_log` read files as the daemon does. `Feed` and `Control` are for a daemon that runs: the
package `holod_client`, which comes along.

Units are in the names: `_mm`, `_m`, `_dpt` (dioptres, 1/metres), `_rad`, `_px`, `_ns`. Arrays of three are red, green,
blue; pictures are (rows, columns, 3), phases and levels (3, rows, columns). Nothing is converted silently: an array of
another shape or type, or a value that is none, raises InputError, which says what was found and expected.
"""

import os

from holod_client import Control, ControlError, Feed, FeedError, FeedTimeoutError, UnansweredError

from holod._holod import Hologram, Renderer, Rig, evaluate, to_srgb8, view
from holod.errors import HolodError, HolodWarning, InputError, RigError, UnavailableError
from holod.log import Blink, PupilLog, read_log
from holod.scene import Scene, builtin_scene, load_scene

# Before a renderer opens Vulkan: a layer of Mesa's would ask the desktop which graphics processor it uses, and wait
# without end for a display server that hangs.
if "MESA_VK_DEVICE_SELECT" not in os.environ:
    os.environ.setdefault("NODEVICE_SELECT", "1")

__all__ = [
    "Blink",
    "Control",
    "ControlError",
    "Feed",
    "FeedError",
    "FeedTimeoutError",
    "HolodError",
    "HolodWarning",
    "Hologram",
    "InputError",
    "PupilLog",
    "Renderer",
    "Rig",
    "RigError",
    "Scene",
    "UnansweredError",
    "UnavailableError",
    "builtin_scene",
    "evaluate",
    "load_scene",
    "read_log",
    "to_srgb8",
    "view",
]
