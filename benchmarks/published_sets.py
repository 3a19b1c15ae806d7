"""Declare the published sets of `make benchmark`: how recordings are read and divided, what is trained, and the paper.

Commands are those of ``tacpipe``, without that word. ``{data}``, ``{recordings}`` and ``{dataset}`` are replaced by the
folder of a set, the datasets that were read, and the dataset that is learned from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Options = Mapping[str, object]  # options of `tacpipe train`, without dashes
SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class TrainedMethod:
    """A method of a set: the options of ``tacpipe train`` in the full and in the quick schedule."""

    name: str
    options: Options = field(default_factory=dict)
    quick: Options = field(default_factory=dict)  # replace options of the full schedule
    paper: bool = False  # whether it is the network of the set's paper


@dataclass(frozen=True)
class TestedFolds:
    """How the recordings of a set are divided into folds."""

    name: str
    words: str  # in the column "tested on"
    split: str  # options of `tacpipe split`
    count: int
    extract: str = ""  # a command for each fold, whose output is learned from


@dataclass(frozen=True)
class PublishedSet:
    """A published set, and everything that is measured on it."""

    name: str
    task: str
    sources: Mapping[str, str]  # folder below DATA -> the command that reads it
    prepare: tuple[str, ...]  # commands from `{recordings}` to `{dataset}`
    dataset: str
    folds: tuple[TestedFolds, ...]
    methods: tuple[TrainedMethod, ...]
    paper: str  # the section of papers.toml; empty: the paper prints no number that can be compared
    tests: tuple[str, ...] = ()  # patterns of the official test in a source folder; empty: the set has none
    # whether the authors' split is in the files, so that `folds` include the official test
    divided: bool = False
    official: str = "--scheme authors --val 0.15"  # options of `tacpipe split` where the official test is present
    train: Options = field(default_factory=dict)  # options of all methods


KFOLD = "--scheme kfold --folds 5 --seed 0"
OBJECTS = TestedFolds(
    "objects", "5 folds, each with objects that were not trained on", f"{KFOLD} --val 0 --group object", 5
)
BLOCKS = TestedFolds("blocks", "5 blocks of time, each tested once", "--scheme leave-one-out --by block --val 0", 5)
LEARNED = (TrainedMethod("auto", quick={"architecture": "linear", "stride": 5}),)


def eflesh(quantity: str, folder: str, layout: str, target: str) -> PublishedSet:
    """Return the declaration of one experiment of eFlesh."""
    return PublishedSet(
        f"eFlesh: {quantity}",
        "regress",
        sources={f"eflesh/{folder}": f"ingest table --layout benchmarks/layouts/{layout}.toml"},
        prepare=(
            f"synchronize {{recordings}} --truth {target} -o {{data}}/synced",
            "segment blocks {data}/synced --parts 5 -o {data}/blocks",
        ),
        dataset="blocks",
        folds=(BLOCKS,),
        methods=LEARNED,
        paper=f"eflesh-{folder.split('_')[0]}",
        train={"target": target},
    )


SETS = (
    PublishedSet(
        "uSkin trials (RSS 2022)",
        "forward",
        sources={"xela_flat_pick_move": "ingest xela-flat"},
        prepare=(
            "synchronize {recordings} -o {data}/synced",
            "segment contacts {data}/synced --rest-s 0.2 -o {data}/segments",
        ),
        dataset="segments",
        folds=(TestedFolds("folds", "5 folds of trials and objects", f"{KFOLD} --apart object --val 0.15", 5),),
        methods=(
            TrainedMethod("default", {"epochs": 16}, {"epochs": 1, "stride": 8}),
            TrainedMethod(
                "recurrent",
                {"preset": "paper", "architecture": "recurrent", "epochs": 50},
                {"epochs": 1, "stride": 8},
                True,
            ),
        ),
        paper="forward",
        tests=("test",),
    ),
    PublishedSet(
        "slides of BioTac and RoboSkin (IROS 2020)",
        "material",
        sources={"biotac_slide_20_50": "ingest biotac-slide", "roboskin_slide_20_50": "ingest roboskin"},
        prepare=("segment slides {recordings} -o {data}/slides",),
        dataset="slides",
        folds=(TestedFolds("authors", "the authors' 4 folds", "--scheme authors --val 0.1 --seed 0", 4),),
        methods=(
            TrainedMethod("minirocket"),
            TrainedMethod(
                "raec-joint",
                {"preset": "paper", "architecture": "raec", "epochs": 2000},
                {"epochs": 2},
                True,
            ),
            TrainedMethod(
                "raec-independent",
                {"preset": "paper", "architecture": "raec", "no-joint": True, "epochs": 2000},
                {"epochs": 2},
                True,
            ),
            TrainedMethod(
                "x-lstm",
                {"preset": "paper", "architecture": "x-lstm", "epochs": 2000},
                {"epochs": 2},
                True,
            ),
        ),
        paper="material",
        tests=("icub_test.npy",),
        divided=True,
    ),
    PublishedSet(
        "grasps with two BioTac SP (RA-L 2020)",
        "touch",
        sources={"vision2tactile": "ingest vision2tactile"},
        prepare=("segment grasps {recordings} -o {data}/grasps",),
        dataset="grasps",
        folds=(
            TestedFolds("known", "5 folds of grasps", f"{KFOLD} --stratify object --val 0", 5),
            TestedFolds("novel", "each object once", "--scheme leave-one-out --by object --val 0", 7),
        ),
        methods=(
            TrainedMethod("default"),
            TrainedMethod(
                "pointnet",
                {
                    "preset": "paper",
                    "architecture": "pointnet",
                    "no-multi-target": True,
                    "wrist": "estimated",
                    "points": 750,
                    "epochs": 250,
                },
                {"epochs": 2, "points": 250},
                True,
            ),
        ),
        paper="touch",
    ),
    PublishedSet(
        "gels that hold objects (GelSight Mini)",
        "slip",
        sources={"gelsight_slip": "ingest gelsight-slip"},
        prepare=(
            "extract difference {recordings} -o {data}/difference",
            "segment losses {data}/difference -o {data}/losses",
        ),
        dataset="losses",
        folds=(OBJECTS,),
        methods=(TrainedMethod("auto", quick={"architecture": "linear"}),),
        paper="gelsight-slip",
        tests=("base_data_for_validation", "validation"),
        train={"rest-s": 0},
    ),
    PublishedSet(
        "stable grasps with three BioTac SP (BTS3)",
        "classify",
        sources={"bts3": "ingest table --layout benchmarks/layouts/bts3.toml"},
        prepare=(),
        dataset="",
        folds=(TestedFolds("poses", "each pose of the hand once", "--scheme leave-one-out --by session --val 0", 2),),
        methods=(TrainedMethod("auto", quick={"architecture": "linear"}),),
        paper="",
        tests=("*_test.csv",),
        official="--scheme authors --val 0",
        train={"label": "slipped", "group": "object", "recentre": "session"},
    ),
    eflesh("normal force", "normal_force", "eflesh", "probe_force"),
    eflesh("shear force", "shear_force", "eflesh", "probe_force"),
    eflesh("place", "spatial_resolution", "eflesh_place", "probe_position_x,probe_position_y"),
    PublishedSet(
        "presses of a TacTip on a surface",
        "regress",
        sources={"tactip_surface": "ingest table --layout benchmarks/layouts/tactip.toml"},
        prepare=(),
        dataset="",
        folds=(
            TestedFolds(
                "presses",
                "5 folds of presses",
                f"{KFOLD} --val 0",
                5,
                "extract autoencoder {recordings} --streams gel --split {split} --fold {fold} -o {data}/features-{fold}",
            ),
        ),
        methods=(TrainedMethod("auto", quick={"architecture": "linear"}),),
        paper="tactip",
        train={"target": "pose_3,pose_4,pose_5"},
    ),
)
