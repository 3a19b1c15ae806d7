"""Subscribers of a live session, one kind a file; none of them is ever waited for."""
