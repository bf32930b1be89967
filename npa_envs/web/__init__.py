"""Live worlds in a browser: the server of `npa-envs view`, and exported HTML files."""
