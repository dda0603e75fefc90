"""Bodies of requests and answers: schemas, JSON, tensors; and what stands in queries."""
