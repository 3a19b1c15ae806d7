"""Chains of commands, as DVC's ``dvc.yaml`` describes them: stages, what each reads and writes, and their order."""
