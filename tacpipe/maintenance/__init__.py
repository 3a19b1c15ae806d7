"""Manage a store beyond one command: collection, repair, transfer to other stores, checkout."""
