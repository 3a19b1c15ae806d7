"""Tables and figures of results, on one page."""
