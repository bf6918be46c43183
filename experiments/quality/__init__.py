"""How good results are, and for what cost."""
