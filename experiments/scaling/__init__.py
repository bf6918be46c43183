"""Memory, communication and work of training, counted and compared with XLA's."""
