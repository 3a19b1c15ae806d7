"""Draw the pictures of the docs: `make pictures`, which runs ``python docs/pictures.py demo/report.html``.

The charts show the tables in ``docs/results/``; the picture of the front page is the first screen of the demo's report.
"""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
TITLES = {  # table -> title of its chart, and the column that groups its rows
    "forward": ("Skill over persistence, known objects, with 95 % interval", "objects"),
    "material": ("Accuracy on slides, %, with 95 % interval", "sensor"),
    "touch": ("Skill over the constant, known objects, with 95 % interval", "target"),
}
VALUES = ("skill", "accuracy_percent")
BLUE, GREY = "#1f6feb", "#6e7781"
WIDTH, HEIGHT = 1280, 800  # size of the first screen, pixels
FLOOR = -1.0  # Rows of lower skill are only in the table, because they would compress the others


def rows(name: str) -> list[dict[str, str]]:
    """Return the rows of a table of results."""
    with (DOCS / "results" / f"{name}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def value_of(row: dict[str, str]) -> float:
    """Return the value of a row of results."""
    return float(next(row[name] for name in VALUES if name in row))


def chart(name: str) -> None:
    """Draw one table, with a dot and an interval per row."""
    from matplotlib.figure import Figure

    title, group = TITLES[name]
    table = [row for row in rows(name) if value_of(row) >= FLOOR]
    figure = Figure(figsize=(7.5, 0.36 * len(table) + 0.9), layout="constrained")
    axes: Any = figure.add_subplot()
    for y, row in enumerate(table):
        baseline = any(word in row["method"] for word in ("baseline", "persistence", "constant", "chance"))
        colour = GREY if baseline else BLUE
        axes.plot([float(row["low"]), float(row["high"])], [y, y], color=colour, linewidth=2)
        axes.plot(value_of(row), y, "o", color=colour, markersize=6)
    labels = [
        f"{row['method']} · {row[group]}" if row[group] not in ("both", "known") else row["method"] for row in table
    ]
    axes.set_yticks(range(len(table)), labels)
    axes.invert_yaxis()
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    axes.grid(axis="x", alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(IMAGES / f"{name}.png", dpi=110, metadata={"Software": None})


def first_screen(page: Path) -> None:
    """Take a picture of the first screen of a report.

    Raises `FileNotFoundError` if Chromium is not installed.
    """
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        raise FileNotFoundError("chromium is not installed; on Debian: sudo apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder:
        screenshot = Path(folder) / "report.png"
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--window-size={WIDTH},{HEIGHT}"]
        flags.append("--timeout=15000")  # ms, in which the page draws its charts
        subprocess.run(
            [browser, *flags, f"--screenshot={screenshot}", page.resolve().as_uri()],
            check=True,
            capture_output=True,
            timeout=300,
        )
        from PIL import Image

        with Image.open(screenshot) as image:
            image.convert("P", palette=Image.Palette.ADAPTIVE, colors=160).save(IMAGES / "report.png", optimize=True)


def main() -> None:
    """Draw all charts, and the first screen of each report in the arguments."""
    IMAGES.mkdir(exist_ok=True)
    for name in TITLES:
        chart(name)
    for page in sys.argv[1:]:
        first_screen(Path(page))


if __name__ == "__main__":
    main()
