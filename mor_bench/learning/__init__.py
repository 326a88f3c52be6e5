"""What networks share: how they are trained. Imported only by methods that use torch."""
