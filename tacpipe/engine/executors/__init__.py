"""Where work is computed: by this computer, or by workers that an executor's plug-in reaches."""
