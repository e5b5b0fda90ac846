"""Reflectance: one Lafortune lobe per texel (paper section 4.4, eq. 1), and what is known of it."""
