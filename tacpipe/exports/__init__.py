"""Export datasets to the file formats of other tools, with a list of what each format cannot represent."""
