"""Report results as tables and figures on one page."""
