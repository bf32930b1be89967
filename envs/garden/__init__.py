"""Rule-driven worlds: a trained rule moves the particles, and an agent acts on them by brushes."""
