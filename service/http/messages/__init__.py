"""Bodies of requests and answers, and parameters of queries."""
