"""Training: optimisers, the stages and their losses, the loop that survives bad steps and restarts."""
