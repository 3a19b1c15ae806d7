"""Encode tactile channels as latents, and decode them."""
