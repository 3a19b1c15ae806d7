"""Headlines of the tasks: one module a task, in numpy alone, so that evaluations and pages compute the same."""
