"""What turns tactile channels into latents and back."""
