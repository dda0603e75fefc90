"""What a run shows people: pictures, plots and the page of a run."""
