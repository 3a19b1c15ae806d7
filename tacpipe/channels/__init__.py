"""The vocabulary of columns: streams, quantities, units, and the sensors' layouts."""
