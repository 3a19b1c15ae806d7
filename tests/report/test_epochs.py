"""Curves over the epochs of training."""

from __future__ import annotations

import re

from tacpipe.report import epochs


def test_curves_are_drawn_in_the_pages_colours_with_the_number_of_runs() -> None:
    drawn = epochs.by_epoch({"a": [[1.0, 0.5], [1.0, 0.4, 0.3]], "b": [[1.0]]}, "loss", "t", log=True)
    assert drawn.startswith("<svg role=")
    assert not re.search(r"#01020\d|#01030\d", drawn)
    assert "a (2 runs)" in drawn and "b (1 run)" in drawn


def test_a_long_name_takes_no_width_from_what_is_drawn() -> None:
    short, long = (epochs.by_epoch({name: [[1.0, 0.5]]}, "loss", "t") for name in ("a", "a name " * 12))
    widths = [re.findall(r'<path d="M [\d.]+ [\d.]+ \nL ([\d.]+) ', one) for one in (short, long)]
    assert max(map(float, widths[1])) > 0.9 * max(map(float, widths[0]))
