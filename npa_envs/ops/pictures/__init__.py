"""Pictures of particles as differentiable torch operators."""
