"""Maintain a store beyond single commands: garbage collection, repair, transfer to other stores, checkout."""
