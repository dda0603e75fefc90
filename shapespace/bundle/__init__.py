"""What passes from training to serving: `schema` says what is in a bundle, `geometry` holds its arrays."""
