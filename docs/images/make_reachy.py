"""Renders the animation *reachy.gif* of a how-to.

    REACHY_PYTHON=PATH PYTHONPATH=benchmarks python -m docs.images.make_reachy

Reachy Mini's head in its own MuJoCo model, with ball joints as shipped, moved over Wi-Fi: crank
angles of which the newest acts at once, and compensated setpoints in plans. Motion, Wi-Fi and the
environment of PATH are those of *benchmarks/reachy.py*. The ring is where the head should be.
"""

import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw
from reachy import PERIOD, SERVOS, SETTLED, arrivals, head_at, motion_file, play, played, send_now
from reachy import setpoints as setpoints_of

import stewart_drake as sd
from docs.images.make_animation import CAPTION, FRAMES_PER_S, SIZE, Studio, lettering, write
from stewart_drake.machines.reachy_mini import HEAD_HEIGHT, pose_of_head

FREQUENCY: Final = 0.5
END: Final = SETTLED + 2 / FREQUENCY
RADIUS: Final = 0.045
"""Of the ring, m."""
DISTANCE: Final = 0.6
"""Of the camera, see `Studio`."""


def film(caption: str, found: dict[str, np.ndarray]) -> list[Image.Image]:
    """Return pictures of the head with its error, from what `play` returns."""
    mechanism, font, pictures = sd.load_mechanism("reachy_mini"), lettering(15), []
    studio = Studio(mechanism, RADIUS, DISTANCE)
    lower = np.array([0.0, 0.0, mechanism.p_PQ[:, 2].mean()])  # from the center of mass to the rods
    for time in np.arange(SETTLED, END - 1e-9, 1 / FRAMES_PER_S):
        k = round(time / PERIOD) - 1  # of the end of a period
        wanted, head = np.eye(4), np.eye(4)
        wanted[:3, :3], wanted[:3, 3] = (part[0] for part in head_at(np.array([time]), FREQUENCY))
        head[:3, :3], head[:3, 3] = found["rotations"][k], found["positions"][k]
        head[2, 3] -= HEAD_HEIGHT
        ringed = pose_of_head(wanted)
        ringed[3:] += wanted[:3, :3] @ lower
        cosine = (np.trace(wanted[:3, :3].T @ head[:3, :3]) - 1) / 2
        error = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        picture = Image.new("RGB", (SIZE[0], SIZE[1] + CAPTION), "white")
        picture.paste(studio.picture(pose_of_head(head), ringed), (0, CAPTION))
        draw = ImageDraw.Draw(picture)
        draw.text((12, 8), caption, fill="#222222", font=font)
        draw.text((12, CAPTION), f"off by {error:.1f} degrees", fill="#c03000", font=font)
        pictures.append(picture)
    return pictures


def main() -> None:
    """Write the animation."""
    servo = SERVOS["perfect"]
    with tempfile.TemporaryDirectory() as folder:
        motion = motion_file(FREQUENCY, Path(folder))
        plain = setpoints_of(motion, servo, plain=True)
        compensated = setpoints_of(motion, servo, 1.0)
    arrived = arrivals(len(plain), 0)
    now = play(servo, 1.0, send_now(plain, plain[0], arrived), plain[0])
    plans = play(servo, 1.0, played(compensated, arrived)[0], plain[0])
    films = [film("crank angles, at once", now), film("compensated, in plans", plans)]
    write(Path(__file__).with_name("reachy.gif"), films)


if __name__ == "__main__":
    main()
