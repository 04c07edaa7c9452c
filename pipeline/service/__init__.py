"""Server for the logs of a lab, with pages and a REST interface to `processed/` (extra ``serve``). Jobs run in separate
processes."""
