"""The bundles being served: found, validated in a process of their own, swapped while requests run."""
