"""Learn any label or quantity from windows of touch: what the tasks classify, regress and slip share."""
