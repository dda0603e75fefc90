"""The networks: factors, combiners, fitting, evaluation, export."""
