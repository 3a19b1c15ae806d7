"""Damage random files of a project: wrong content is never read, and everything that can be recomputed is repaired."""

import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tacpipe.errors import DAMAGED, USAGE
from tests.conftest import Lab
from tests.promises import damages, specimen
from tests.promises.counts import count
from tests.promises.specimen import CHAIN, Specimen

Harm = tuple[int, str, float, int]  # number of the file, damage, where a bit is flipped and which
HARMS = st.tuples(st.integers(0, 10**6), st.sampled_from(sorted(damages.ALL)), st.floats(0, 1), st.integers(1, 255))
FIRST = st.sampled_from(["", "store verify", "store repair", "store gc --recordings --grace-days 0", *CHAIN])
BY_HAND = "recordings/manifest.json"


def harm(project: Specimen, harms: list[Harm]) -> None:
    """Harm files of the store and beneath data/; the mark of the store's format is left alone."""
    for number, damage, share, mask in harms:
        paths = [path for path in specimen.beneath(project.store) if path.name != "format"]
        paths += specimen.beneath(project.folder / "data")
        path = paths[number % len(paths)]
        if path.stat().st_size:
            damages.flip(path, share, mask) if damage == "a bit is flipped" else damages.ALL[damage](path)
            count("corruptions found")


def nothing_wrong_is_read_and_all_is_healed(project: Specimen, harms: list[Harm], first: str) -> None:
    harm(project, harms)
    project.served()  # right, or refused
    commands = [*([first] if first else []), "store verify", "store repair", *CHAIN]
    for ran in map(project.lab.call, commands):
        assert ran.code in (0, 2, DAMAGED), ran
        reported = ran.err or any(word in ran.out for word in ("damaged", "missing", "cannot be made"))
        assert "Traceback" not in ran.err and (ran.code == 0 or reported), ran
    project.served()
    (project.folder / "data" / BY_HAND).write_bytes(
        project.sound[BY_HAND]
    )  # git would restore it: its label may be nowhere else.
    refused = project.lab.call(CHAIN[1])
    if refused.code == DAMAGED and "remove it" in refused.err:  # labels may have stood in it: a person decides
        (project.folder / "data/simulated/manifest.json").unlink()
        second_try = project.lab.call(CHAIN[1])
        if (
            second_try.code == USAGE and "did not write" in second_try.err
        ):  # root and shard are damaged too: whose files are they?
            shutil.rmtree(project.folder / "data/simulated")
    for ran in project.rerun():
        assert ran.code == 0, ran
    assert project.data_files() == dict(project.sound)
    assert project.lab.call("store repair").code == 0
    assert project.lab.call("store verify").code == 0
    specimen.age(project.folder)
    assert project.lab.call("store gc --recordings --grace-days 0").code == 0
    assert all(project.served().values())


@example(harms=[(number, "a bit is flipped", 0.0, 1) for number in (1061, 1549, 10382)], first="")
@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
@given(harms=st.lists(HARMS, min_size=1, max_size=8), first=FIRST)
def test_whatever_is_damaged_nothing_wrong_is_read_and_all_is_healed(
    original: Path, lab: Lab, harms: list[Harm], first: str
) -> None:
    nothing_wrong_is_read_and_all_is_healed(specimen.copy(original, lab), harms, first)


@pytest.mark.faults
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(harms=st.lists(HARMS, min_size=1, max_size=40), first=FIRST)
def test_however_much_is_damaged_nothing_wrong_is_read_and_all_is_healed(
    original: Path, lab: Lab, harms: list[Harm], first: str
) -> None:
    nothing_wrong_is_read_and_all_is_healed(specimen.copy(original, lab), harms, first)
