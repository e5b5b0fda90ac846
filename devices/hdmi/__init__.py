"""A projector that is a second screen of this computer."""
