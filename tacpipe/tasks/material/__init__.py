"""Which material is under the finger? Told from one slide of a tactile sensor, and learned jointly across unlike ones.

A slide is the table of frames that ``tacpipe segment slides`` keeps of a recording. Each sensor has its own reader;
networks may be trained so that slides of the same material get the same latents, whichever sensor felt them.
"""
