"""One question a file: how its model is trained and evaluated."""
