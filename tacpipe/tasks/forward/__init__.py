"""Predict future tactile signals of the fingertips from past signals, past motion and the planned motion of the arm.

A window consists of ``context`` rows t-9 … t of touch and arm, the arm of the ``horizon`` rows t+1 … t+10 as the plan,
and the touch of these rows as the target. The recorded motion serves as the plan, so errors are those of an arm that
follows its plan.
"""
