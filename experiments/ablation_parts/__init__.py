"""The parts of experiments/ablation.py."""
