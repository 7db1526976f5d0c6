"""The directions of a Manhattan or Atlanta world: modes, searches, fits, identities."""
