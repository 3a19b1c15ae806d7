"""Future tactile signals of the fingertips, predicted from past ones, past motion and the planned motion of the arm.

A window is ``context`` rows t-9 … t of touch and arm, the arm of the ``horizon`` rows t+1 … t+10 as the plan, and the
touch of these rows as the answer. The recorded motion serves as the plan, so errors hold for an arm that
follows its plan.
"""
