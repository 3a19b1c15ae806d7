"""`train TASK --requirements` prints what the task needs: recordings without it are refused, others are read."""

import re
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from tacpipe.errors import TacpipeError
from tacpipe.plugins import params as params_of
from tacpipe.plugins import registry
from tacpipe.tasks.forward import tracks
from tacpipe.tasks.forward.params import REQUIREMENTS as FORWARD
from tacpipe.tasks.material import slides as material_slides
from tacpipe.tasks.material.task import REQUIREMENTS as MATERIAL
from tests.conftest import Lab
from tests.fake_recordings import FakeShard
from tests.tasks.material.textures import dataset as slides_of
from tests.tasks.material.textures import slide

TASKS = sorted(registry.entry_points()[registry.TASKS])
DOCS = Path(__file__).parents[1] / "docs" / "tasks"


def field(name: str, quantity: str, unit: str, kind: Any = None) -> pa.Field:
    about = {"quantity": quantity, "unit": unit, "stream": name.partition("_")[0], "rest": "0"}
    return pa.field(name, kind or pa.float64(), metadata=about)


FIELDS = [
    pa.field("t_ns", pa.int64()),
    *(field(f"skin_t{n}", "tactile", "V") for n in range(3)),
    *(field(f"arm_{part}", "position", "cm") for part in "xyz"),
    *(field(f"arm_q{part}", "orientation", "1") for part in "xyzw"),
    *(field(f"arm_j{n}", "joint_position", "rad") for n in range(7)),
    *(field(f"arm_v{n}", "joint_velocity", "rad/s") for n in range(7)),
    field("hand_width", "finger_width", "mm"),
    pa.field("contact", pa.int32(), metadata={"quantity": "label"}),
]


def without(quantity: str) -> FakeShard:
    """A recording that has all that forecasts can read but ``quantity``."""
    fields = [field for field in FIELDS if (field.metadata or {}).get(b"quantity") != quantity.encode()]
    columns = [
        pa.array([1] * 40, field.type) if field.name != "t_ns" else pa.array(range(40), pa.int64()) for field in fields
    ]
    return FakeShard("trial", pa.Table.from_arrays(columns, schema=pa.schema(fields)), {"object": "cup"})


def read(shard: Any, actions: str) -> tracks.Track:
    codec = tracks.codec_of(shard.content.schema, {}, shard.name)
    return tracks.track(shard, codec, tracks.select_pose(shard, actions))


@pytest.mark.parametrize("quantity", [channels.quantity for channels in FORWARD.channels])
def test_forecasts_refuse_recordings_without_what_is_needed_and_read_those_without_the_rest(quantity: str) -> None:
    if quantity in FORWARD.needed:
        with pytest.raises(TacpipeError, match=f'{quantity}.*quantity = "{quantity}".*layout file'):
            read(without(quantity), "none")
    else:
        assert read(without(quantity), "none").usable.all()


def test_what_forecasts_can_do_without_is_everything_but_touch() -> None:
    assert FORWARD.needed == ("tactile",)
    assert set(FORWARD.needed) < {(field.metadata or {}).get(b"quantity", b"").decode() for field in FIELDS}
    with pytest.raises(TacpipeError, match="--actions none"):
        read(without("position"), "planned")


@pytest.mark.parametrize("label", [label.name for label in MATERIAL.labels])
def test_materials_refuse_slides_without_a_needed_label_and_read_those_without_the_rest(label: str) -> None:
    slides = slides_of(slide("biotac", 1, 0, **{"session": "a", label: None}))
    needed = {needed_label.name for needed_label in MATERIAL.labels if not needed_label.without}
    if label in needed:
        with pytest.raises(TacpipeError, match=f"no label {label}"):
            material_slides.read(slides, labelled=True)
    else:
        assert len(material_slides.read(slides, labelled=True)["biotac"]) == 1


def test_materials_refuse_slides_without_touch() -> None:
    bare = slide("biotac", 1, 0)
    bare.tables["slide"] = bare.tables["slide"].select(["t_ns"])  # type: ignore[index]
    with pytest.raises(TacpipeError, match=r'quantity = "tactile".*layout file'):
        material_slides.read(slides_of(bare), labelled=True)


@pytest.mark.parametrize("task", TASKS)
def test_every_task_prints_what_it_needs_without_a_dataset_and_its_page_has_it(lab: Lab, task: str) -> None:
    requirements = registry.requirements(f"train.{task}")
    assert requirements is not None and requirements.task == task
    printed = lab.run(f"train {task} --requirements").out
    assert printed == requirements.to_text() + "\n"
    for channels in requirements.channels:
        assert channels.quantity in printed and all(unit in printed for unit in channels.units)
    assert printed in (DOCS / f"{task}.md").read_text()
    assert max(map(len, printed.splitlines())) <= 112
    stage_names = registry.stages()
    for name in requirements.stages:
        assert name.replace(" ", ".") in stage_names


@pytest.mark.parametrize("task", TASKS)
def test_the_options_that_requirements_name_exist(task: str) -> None:
    stage, requirements = registry.load(f"train.{task}"), registry.requirements(f"train.{task}")
    assert requirements is not None
    flags = {f"--{name.replace('_', '-')}" for name in params_of.fields(stage)}
    flags |= {f"--{name.replace('_', '-')}" for name in params_of.fields(registry.load("segment.slides"))}
    flags |= {"--from", "--interval", "--truth"}
    assert set(re.findall(r"--[a-z-]+", requirements.to_text())) <= flags
