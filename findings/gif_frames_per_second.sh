#!/usr/bin/env bash
# imageio 2.37.4 and matplotlib 3.11.2, both by pillow 13.0.0: a GIF asked to play at 60 frames a second plays at 100.
# Expected: 60 is Bullet's and MuJoCo's render_fps; a film of an episode lasts as long as the episode.
# Behaviour: GIF counts hundredths of a second. 16.7 ms is cut to 10, frame by frame, and what is cut is not
#   carried over to the next; 30 becomes 33.3, and only divisors of 100 are kept.
# Seen: asked 50, 60, 30: imageio 50.0 100.0 33.3, matplotlib 50.0 100.0 33.3
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q imageio==2.37.4 matplotlib==3.11.2 pillow==13.0.0 numpy==2.4.6
cd "$folder"
found=$("$folder/env/bin/python" - <<'PYTHON'
import imageio.v3 as imageio
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import PillowWriter
from PIL import Image, ImageSequence

FRAMES = 12


def by_imageio(path, fps):
    frames = [np.full((16, 16, 3), 20 * shade, np.uint8) for shade in range(FRAMES)]
    imageio.imwrite(path, frames, fps=fps)


def by_matplotlib(path, fps):
    figure, axes = plt.subplots(figsize=(1, 1))
    writer = PillowWriter(fps=fps)
    with writer.saving(figure, path, dpi=50):
        for step in range(FRAMES):
            axes.plot([0, step])
            writer.grab_frame()


found = []
for name, write in {"imageio": by_imageio, "matplotlib": by_matplotlib}.items():
    rates = []
    for fps in (50, 60, 30):
        write("film.gif", fps)
        film = Image.open("film.gif")
        times = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
        rates.append(f"{1000 * len(times) / sum(times):.1f}")
    found.append(" ".join([name, *rates]))
print("asked 50, 60, 30:", ", ".join(found))
PYTHON
)
echo "$found"
[ "$found" = "asked 50, 60, 30: imageio 50.0 100.0 33.3, matplotlib 50.0 100.0 33.3" ]
