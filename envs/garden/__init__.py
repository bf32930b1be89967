"""Living worlds: a trained rule runs the particles, and an agent acts from outside."""
