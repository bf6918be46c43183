"""Drawings of the pages that show no result: what the ready-made camera paths look like."""
