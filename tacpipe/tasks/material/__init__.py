"""Classify the material under the finger from one slide of a tactile sensor, with joint learning across different sensors.

A slide is the table of frames that ``tacpipe segment slides`` extracts from a recording. Each sensor has its own
reader. Networks can be trained so that slides of the same material have the same latents, whichever sensor recorded
them.
"""
