"""Render docs/balance.gif, the picture of README: copying and the shipped follower `balance` with the same load.

    python docs/readme_picture.py [OUT.gif]

One cycle of a CG that moves +-10 cm at 1 rad/s (6.3 s), in real time and in steady state, so that the loop closes.
Needs Pillow and a GL library of MuJoCo (MUJOCO_GL=egl on a machine without a display).
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from mjxball import Scenario, simulate
from mjxball.baselines import make_baseline
from mjxball.config import preset
from mjxball.evaluate.render import frames
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy

START, OMEGA, FRAMES = 25.0, 1.0, 63  # [s], [rad/s], one frame each 0.1 s
LABELS = ("copying the leader", "balance (trained)")
COLOURS = 96


def main() -> None:
    """Fly both followers, render one cycle, write the GIF."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "balance.gif"
    config = preset("transport")
    scenario = Scenario(omega=OMEGA, amplitude=0.10, goal=(1.0, 0.0, 1.0), seconds=START + 7.0)
    followers = make_baseline("copy", config), Policy.load(shipped_policy("balance"))
    flights = [simulate(config, follower, scenario, "newton-euler") for follower in followers]
    rows = np.searchsorted(flights[0].time, START + np.arange(FRAMES) * 2 * math.pi / OMEGA / FRAMES)
    arrays = {
        "time": flights[0].time[rows],
        "position": np.stack([flight.position[rows] for flight in flights]),
        "quaternion": np.stack([flight.quaternion[rows] for flight in flights]),
        "offset": np.stack([flight.cg_offset[rows] for flight in flights]),
        "goal": flights[0].target[rows],
    }
    pictures = frames(config.plant, LABELS, arrays, panel=(300, 400))
    palette = pictures[0].quantize(COLOURS, dither=Image.Dither.NONE)
    shown = [picture.quantize(COLOURS, palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    shown[0].save(out, save_all=True, append_images=shown[1:], duration=100, loop=0, optimize=True)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")  # noqa: T201


if __name__ == "__main__":
    main()
