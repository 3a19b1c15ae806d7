"""Return the truth of a simulated grasp as a table of one row: forces, contacts, pose, and the best possible estimate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from tacpipe.arrays import Floats
from tacpipe.channels import biotac_sp, schema
from tacpipe.simulation import fingertip_sp, touch_bound
from tacpipe.simulation.grasp_scene import GraspRig, GraspScene, Readings


def bound(
    hand: fingertip_sp.Sensors, scene: GraspScene, rig: GraspRig, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return mean and variance of what the sensors may read, given the geometry alone, each (finger, channel)."""
    possible = touch_bound.readings(
        scene.situation,
        hand,
        rng,
        effort_spread=rig.effort_spread,
        noise_scale=rig.noise_scale,
        drift_count_day=rig.drift_count_day,
    )
    return touch_bound.mean_and_variance(possible)


def table(
    t_ns: int, scene: GraspScene, sensed: Readings, estimate: tuple[Floats, Floats], moments_ns: Mapping[str, int]
) -> pa.Table:
    """Return the stream ``truth``: of each finger, gt_mf_… and gt_th_…, then of the object.

    ``gt_expected_…`` is the mean and ``gt_variance_…`` the variance of a reading given the geometry, counts and counts
    squared; ``moments_ns`` are when fingers touch, hold and let go, in nanoseconds, each a column ``gt_…_ns``.
    """
    columns = [column for finger in range(len(biotac_sp.FINGERS)) for column in _finger(finger, scene, sensed)]
    columns += [(f"gt_position_{axis}_m", "m", "position", scene.placed.origin_m[i]) for i, axis in enumerate("xyz")]
    columns += [
        (f"gt_rotation_{axis}_{part}", "1", "orientation", scene.placed.rotation[i, j])
        for j, axis in enumerate("xyz")
        for i, part in enumerate("xyz")
    ]
    columns += [(f"gt_up_{axis}", "1", "orientation", scene.up[i]) for i, axis in enumerate("xyz")]
    columns.append(("gt_compliance_1_pa", "1/Pa", "compliance", scene.thing.compliance_1_pa))
    for name, unit, estimates in zip(("expected", "variance"), ("count", "count^2"), estimate, strict=True):
        columns += [
            (f"gt_{name}_{column}", unit, "tactile", estimates[finger, channel])
            for finger, short in enumerate(biotac_sp.FINGERS)
            for channel, column in enumerate(biotac_sp.columns(f"e_{short}") + biotac_sp.columns(f"pdc_{short}"))
        ]
    fields = [schema.float_field(name, unit, quantity) for name, unit, quantity, _ in columns]
    moments = [
        pa.field(f"gt_{name}_ns", pa.int64(), metadata={"unit": "ns", "quantity": "time"}) for name in moments_ns
    ]
    values = [*([value] for *_, value in columns), *([at] for at in moments_ns.values())]
    return schema.stream(np.array([t_ns]), values, [*fields, *moments])


def _finger(finger: int, scene: GraspScene, sensed: Readings) -> list[tuple[str, str, str, float]]:
    """Return name, unit, quantity and value of what is true of a finger."""
    touch, situation = sensed.touch, scene.situation
    columns = [
        ("force_n", "N", "force", touch.force_n[0, finger]),
        ("effort", "1", "share", scene.hidden.effort[0, finger]),
        ("radius_m", "m", "length", touch.contact_m[0, finger]),
        ("indentation_m", "m", "length", touch.skin_m[0, finger]),
        ("centre_along_m", "m", "position", touch.centre_m[0, finger, 0]),
        ("centre_around_m", "m", "position", touch.centre_m[0, finger, 1]),
        ("curvature1_1_m", "1/m", "curvature", situation.curvatures_1_m[finger, 0]),
        ("curvature2_1_m", "1/m", "curvature", situation.curvatures_1_m[finger, 1]),
        ("lean_along_rad", "rad", "angle", situation.lean_rad[finger, 0]),
        ("lean_around_rad", "rad", "angle", situation.lean_rad[finger, 1]),
        ("pdc_drift_count", "count", "static_pressure", sensed.drift[finger, -1]),
    ]
    return [(f"gt_{biotac_sp.FINGERS[finger]}_{name}", unit, kind, float(value)) for name, unit, kind, value in columns]
