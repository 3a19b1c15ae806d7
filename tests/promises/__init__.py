"""Tests of what a lab is promised: faults, kills, crowds, corruption, hostile input; slow ones carry the mark ``faults``."""
