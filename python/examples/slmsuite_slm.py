"""Puts holod's phase on an SLM through slmsuite: `python slmsuite_slm.py` shows the built-in scene on a simulated one.

    pip install slmsuite

Any SLM of slmsuite does: replace `SimulatedSLM` in `main` by yours (`slmsuite.hardware.slms`) and give holod the rig
file of your bench, with the same pixels. An SLM of slmsuite shows one colour; with three lasers, set the phase of each
colour in turn.

slmsuite, like holod, takes a larger phase for a longer delay, and turns it into the SLM's own levels, with the
correction that was loaded there. If near and far are swapped on your bench, its conjugate order is used: give it
-phase_rad.
"""

from __future__ import annotations

import argparse

import holod
from slmsuite.hardware.slms.simulated import SimulatedSLM

COLOURS = ("red", "green", "blue")


def show(slm: SimulatedSLM, hologram: holod.Hologram, colour: str) -> None:
    """Shows one colour of `hologram`; slmsuite puts a pattern that is smaller in the middle of the SLM."""
    slm.set_phase(hologram.phase_rad[COLOURS.index(colour)])


def main() -> None:
    parser = argparse.ArgumentParser(description="holod's phase on an SLM of slmsuite")
    parser.add_argument("--pupil-mm", type=float, default=3.0, help="the pupil that the hologram is for")
    parser.add_argument("--colour", choices=COLOURS, default="green")
    parser.add_argument("--weights", default="standard", help="standard, small, fast or a file")
    parser.add_argument("--size", type=int, nargs=2, metavar=("WIDTH", "HEIGHT"), default=(512, 512))
    options = parser.parse_args()

    rig = holod.Rig.builtin()
    width_px, height_px = options.size
    pitch_um = rig.pixel_pitch_m * 1e6
    wavelength_um = rig.wavelengths_m[COLOURS.index(options.colour)] * 1e6
    slm = SimulatedSLM((width_px, height_px), pitch_um=(pitch_um, pitch_um), wav_um=wavelength_um)

    scene = holod.builtin_scene(width_px, height_px)
    renderer = holod.Renderer(rig, options.weights, width_px=width_px, height_px=height_px)
    hologram = renderer.render(
        scene.rgb, scene.depth, options.pupil_mm, colour=scene.colour, depth_unit=scene.depth_unit
    )
    show(slm, hologram, options.colour)
    print(f"{hologram}: {options.colour} in levels {slm.display.min()} to {slm.display.max()}")


if __name__ == "__main__":
    main()
