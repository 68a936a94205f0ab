#!/usr/bin/env bash
# matplotlib 3.11.2: a figure that is saved twice, with nothing changed between, is another picture.
# Expected: a layout engine finds the same places for the same figure, so equal PNG files.
# Behaviour: a layout is found anew at each saving, from where the last one left the axes, and these end
#   parts of a pixel apart; with "tight" it never settles.
# Seen: constrained differs, then settles; tight differs each time; none is equal
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q numpy==2.4.6 matplotlib==3.11.2
found=$("$folder/env/bin/python" - <<'PYTHON'
import io

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def picture(figure):
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


for layout in ("constrained", "tight", "none"):
    figure, axes = plt.subplots(1, 2, figsize=(6, 3), layout=layout)
    for panel in axes:
        panel.plot([0, 1], [0, 2000])
        panel.set(xlabel="episode", ylabel="return")
    saved = [picture(figure) for _ in range(5)]
    print(layout, *("equal" if a == b else "other" for a, b in zip(saved, saved[1:])))
PYTHON
)
echo "$found"
[ "$found" = "constrained other equal equal equal
tight other other other other
none equal equal equal equal" ]
