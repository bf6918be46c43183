"""What the model and its training stand, and where they break."""
