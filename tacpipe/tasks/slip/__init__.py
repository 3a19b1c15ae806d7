"""The task slip: the probability that a held object slips within the next moment, from the last second of touch.

It works with any tactile channels, such as taxels, markers of a gel or features of an encoder.
"""
