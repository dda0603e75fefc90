"""The Riemannian space of discrete shells: energy, exponential map, geodesics, means, parallel transport."""
