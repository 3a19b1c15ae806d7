"""What starting the command line may import: a rerun must not wait for libraries that it does not use."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests import chain

HEAVY = {"torch", "pyarrow", "pandas", "sklearn", "open3d", "numpy", "scipy", "matplotlib"}
PROBE = """
import json, sys
from tacpipe.cli import main as cli
sys.argv = ["tacpipe", *sys.argv[1:]]
try:
    cli.main()
except SystemExit as stop:
    assert not stop.code, stop.code
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def imported(folder: Path, words: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", PROBE, *words.split()], cwd=folder, capture_output=True, text=True, check=True
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.fixture(scope="module")
def lab(chained: Path) -> Path:
    return chained


@pytest.mark.parametrize(
    "words", ["--help", "train --help", "train forward --help", "store gc --help", "show --help", "candidates --help"]
)
def test_help_imports_nothing_heavy(tmp_path: Path, words: str) -> None:
    assert imported(tmp_path, words) & HEAVY == set()


@pytest.mark.parametrize("words", chain.CHAIN, ids=lambda words: words.split()[0])
def test_a_hit_imports_nothing_heavy(lab: Path, words: str) -> None:
    assert imported(lab, words) & HEAVY == set()


def test_explaining_and_looking_after_the_store_import_nothing_heavy(lab: Path) -> None:
    for words in ("explain report.html", "store status", "store verify", "store gc --dry-run"):
        assert imported(lab, words) & HEAVY == set()


def test_ingest_does_not_import_torch(tmp_path: Path, lab: Path) -> None:
    assert "torch" not in imported(lab, "synchronize data/recordings -o data/other --rate-hz 20 --jobs 1")
