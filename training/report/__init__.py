"""The report of a run: pictures, charts and one HTML page."""
