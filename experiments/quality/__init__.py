"""Measuring the trained model: scenes, measures, knobs and charts of `mini_quality.py`."""
