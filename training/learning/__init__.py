"""The networks: factors, the combiner with its kinds of correction, baselines; fitting, evaluation, export."""
