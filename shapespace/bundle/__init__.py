"""What passes from training to serving: a folder of networks and arrays under a manifest."""
