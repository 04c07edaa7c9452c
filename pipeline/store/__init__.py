"""From files of a lab to `processed/` and back: ingest, quarantine, batches, devices, published values."""
