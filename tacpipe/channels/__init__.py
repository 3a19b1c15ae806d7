"""The vocabulary of columns: streams, quantities, units, and sensor layouts."""
