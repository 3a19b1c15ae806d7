"""The maths of recorded signals: numpy arrays in, numpy arrays out."""
