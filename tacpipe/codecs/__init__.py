"""Turn tactile channels into latents and back."""
