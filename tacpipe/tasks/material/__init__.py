"""The material under the finger, classified from one slide of a tactile sensor, learned jointly across unlike sensors.

A slide is the table of frames that ``tacpipe segment slides`` keeps of a recording. Each sensor has its own reader;
networks may be trained so that slides of the same material get the same latents, whichever sensor recorded them.
"""
