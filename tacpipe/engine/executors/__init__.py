"""Run tasks on this computer, or on workers that an executor's plug-in reaches."""
