"""Bodies of requests and answers: schemas, JSON, uploads, tensors."""
