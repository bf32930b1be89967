"""What every environment of one rule's worlds shares: configuration, worlds, spaces, views."""
