"""What will the fingertips feel over the next steps, given the planned motion of the arm?

A window is ``context`` rows t-9 … t of touch and arm, the arm of the ``horizon`` rows t+1 … t+10 as the plan, and the
touch of these rows as the answer. The recorded motion stands for the plan, so what is measured holds for an arm that
does as it was told.
"""
