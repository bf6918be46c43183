"""What the planner spends and loses, from an empty room to clutter."""
