"""Test networks and servers that fail at each request of a push and of a pull: for a moment, or from then on."""

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tacpipe.maintenance import repair
from tacpipe.store import bucket
from tacpipe.store.store import Store
from tests.conftest import Lab, Ran, without_created_store
from tests.promises.counts import count
from tests.stores import places
from tests.stores.places import SECRET, Place
from tests.stores.proxy import FAULTS, WRONG_ANSWERS, Proxy

EVERY = pytest.mark.parametrize(
    "stride", [pytest.param(1, marks=pytest.mark.faults), pytest.param(13, marks=pytest.mark.long)]
)
LASTING = ("refused", "503", "cut upload", "cut answer")


pytestmark = pytest.mark.usefixtures("impatient")


@pytest.fixture
def data(lab: Lab) -> Lab:
    """A project with a dataset of two shards."""
    lab.run("simulate toy -o data/r --trials 2 --rows 3")
    lab.run("scale data/r -o data/s --factor 1")
    return lab


def at(step: int, fault: str | None) -> Callable[[int], str | None]:
    """Return what fails the request of a number."""
    return lambda number: fault if number == step else None


def since(step: int, fault: str) -> Callable[[int], str | None]:
    """Return what fails all requests from a number on."""
    return lambda number: fault if number >= step else None


class Remotes:
    """A new store for each try, which a push fills."""

    def __init__(self, lab: Lab, faulty: Proxy) -> None:
        self.lab, self.faulty, self.number = lab, faulty, 0

    def next(self) -> Place:
        self.number += 1
        return places.bucket(f"s3://lab/try-{self.number}")

    def under(self, fault: Callable[[int], str | None], command: str) -> Ran:
        """Run a command while requests fail, and no other."""
        self.faulty.begin(fault)
        try:
            return self.lab.call(command)
        finally:
            self.faulty.fault = lambda number: None


@pytest.fixture
def remotes(data: Lab, faulty: Proxy) -> Remotes:
    return Remotes(data, faulty)


@pytest.mark.parametrize("fault", ["503", "cut upload"])
def test_a_push_and_a_pull_outlast_faults_and_one_that_cannot_says_so(remotes: Remotes, fault: str) -> None:
    place = remotes.next()
    remotes.lab.run(f"store push {place.address} data/r")
    assert (
        remotes.under(lambda number: fault if number % 4 == 3 else None, f"store push {place.address} data/s").code == 0
    )
    lost = remotes.under(since(1, fault), f"store pull {place.address} data/s")
    assert lost.code == 1 and lost.err.count("\n") == 1 and place.address in lost.err and SECRET not in lost.err
    assert (
        remotes.under(lambda number: fault if number % 4 == 3 else None, f"store pull {place.address} data/s").code == 0
    )


@EVERY
@pytest.mark.parametrize("fault", FAULTS)
def test_a_push_outlasts_a_fault_of_any_one_request(remotes: Remotes, fault: str, stride: int) -> None:
    reference = remotes.next()
    remotes.under(at(0, None), f"store push {reference.address} data/s")
    requests, expected = remotes.faulty.requests, reference.whole()
    assert requests > 15 and len(expected) == 4 + 5  # objects; records of shards, and of them as a group
    for step in range(1 + len(fault) % stride, requests + 1, stride):
        place = remotes.next()
        ran = remotes.under(at(step, fault), f"store push {place.address} data/s")
        assert ran.code == 0, (step, ran.err)
        assert place.whole() == expected, step
        count("requests to a store failed")


@EVERY
@pytest.mark.parametrize("fault", LASTING)
def test_a_push_that_fails_for_good_ends_in_a_sentence_and_its_rerun_gives_the_same_bytes(
    remotes: Remotes, fault: str, stride: int
) -> None:
    reference = remotes.next()
    remotes.under(at(0, None), f"store push {reference.address} data/s")
    requests, expected, failed = remotes.faulty.requests, reference.whole(), 0
    for step in range(1 + len(fault) % stride, requests + 1, stride):
        place = remotes.next()
        ran = remotes.under(since(step, fault), f"store push {place.address} data/s")
        assert ran.code in (0, 1) and without_created_store(ran.err).count("\n") == ran.code, (step, ran)
        failed += ran.code
        assert SECRET not in ran.err + ran.out and "Traceback" not in ran.err
        assert remotes.lab.run(f"store push {place.address} data/s").code == 0
        assert place.whole() == expected, step
        assert remotes.lab.run(f"store verify --remote {place.address}").out.endswith("all sound\n")
        count("requests to a store failed")
    assert failed > 0


@EVERY
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("lasting", [False, True])
def test_a_pull_outlasts_a_fault_or_ends_in_a_sentence_and_its_rerun_gives_the_same_bytes(
    remotes: Remotes, fault: str, lasting: bool, stride: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = remotes.next()
    remotes.lab.run(f"store push {place.address} data/s")
    expected = (remotes.lab.folder / "data/s/manifest.json").read_bytes()

    def cloned(number: int) -> Path:
        folder = remotes.lab.folder.with_name(f"{remotes.lab.folder.name}-{number}")
        (folder / ".tacpipe").mkdir(parents=True)
        monkeypatch.chdir(folder)
        return folder

    folder = cloned(0)
    remotes.under(at(0, None), f"store pull {place.address} data/s")
    requests = remotes.faulty.requests
    assert requests > 8
    for step in range(1 + len(fault) % stride, requests + 1, stride):
        folder = cloned(step)
        fails = since(step, fault) if lasting else at(step, fault)
        ran = remotes.under(fails, f"store pull {place.address} data/s")
        if not lasting or fault == "slow":
            assert ran.code == 0, (step, ran.err)
        assert ran.code in (0, 1) and without_created_store(ran.err).count("\n") == ran.code, (step, ran)
        remotes.lab.run(f"store pull {place.address} data/s")
        assert (folder / "data/s/manifest.json").read_bytes() == expected
        assert repair.verify(Store(folder / ".tacpipe")).clean
        shutil.rmtree(folder)
        count("requests to a store failed")


@pytest.mark.long
def test_an_object_of_several_parts_goes_over_although_the_connection_is_lost_in_the_middle(
    faulty: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bucket, "PART_BYTES", 5 << 20)
    blocks = [bytes([number]) * (1 << 20) for number in range(13)]
    name = f"objects/ab/{'ab' * 32}"
    for fault in ("cut upload", "lost answer", "503", "cut answer"):
        for step in range(1, 6):
            place = places.bucket(f"s3://lab/{fault.replace(' ', '-')}-{step}")
            faulty.begin(at(step, fault))
            assert place.files.create(name, blocks), (fault, step)
            faulty.begin(at(step, fault))
            assert b"".join(place.files.blocks(name, 13 << 20)) == b"".join(blocks), (fault, step)
            count("requests to a store failed", 2)


LONGEST_S, MOST_REQUESTS = 30.0, 600
SUCCEEDS_UNNOTICED = {"uploads are lost"}  # the server acknowledges what it does not keep: a verification names it


@pytest.mark.parametrize("kind", WRONG_ANSWERS)
def test_wrong_answers_end_in_a_sentence_and_harm_nothing(
    remotes: Remotes, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab, faulty = remotes.lab, remotes.faulty
    full, pushed = remotes.next(), remotes.next()
    lab.run(f"store push {full.address} data/s")
    expected = full.whole()
    manifest = (lab.folder / "data/s/manifest.json").read_bytes()

    def call(command: str) -> Ran:
        begun_s = time.monotonic()
        faulty.begin(lambda number: None)
        faulty.change = WRONG_ANSWERS[kind]
        watch = threading.Timer(LONGEST_S, setattr, (faulty, "change", WRONG_ANSWERS["403"]))
        watch.start()
        try:
            ran = lab.call(command)
        finally:
            watch.cancel()
            faulty.change = None
        assert time.monotonic() - begun_s < LONGEST_S and faulty.requests < MOST_REQUESTS, (command, faulty.requests)
        assert ran.code in (0, 1, 2, 4) and "Traceback" not in ran.err and SECRET not in ran.err + ran.out
        if ran.code in (1, 2) or (ran.code == 4 and ran.err):
            assert ran.err.startswith("tacpipe: ") and ran.err.count("\n") == 1, (command, ran)
            assert "A file cannot be used" not in ran.err
        count("requests to a store failed", faulty.requests)
        return ran

    ran = call(f"store push {pushed.address} data/s")
    assert ran.code or kind in SUCCEEDS_UNNOTICED or pushed.whole() == expected
    if ran.code == 0 and kind in SUCCEEDS_UNNOTICED:
        assert lab.call(f"store verify --remote {pushed.address}").code == 4
    lab.run(f"store push {pushed.address} data/s")
    assert pushed.whole() == expected
    for command in ("store list --store", "store verify --remote"):
        ran = call(f"{command} {full.address}")
        assert "now in quarantine" not in ran.out
        assert lab.run(f"{command} {full.address}").code == 0
    assert full.whole() == expected

    folder = lab.folder.with_name(f"{lab.folder.name}-clone")
    (folder / ".tacpipe").mkdir(parents=True)
    monkeypatch.chdir(folder)
    ran = call(f"store pull {full.address} data/s")
    assert ran.code or (folder / "data/s/manifest.json").read_bytes() == manifest
    assert repair.verify(Store(folder / ".tacpipe")).clean
    lab.run(f"store pull {full.address} data/s")
    assert (folder / "data/s/manifest.json").read_bytes() == manifest
