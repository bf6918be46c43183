"""How long a call takes: networks, training steps, published sizes on an accelerator."""
