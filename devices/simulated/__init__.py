"""A simulated rig: a painting, its light, its camera and projector, with real lenses and noise."""
