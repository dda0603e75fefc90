"""Requests and answers: routes, schemas, formats, problems."""
