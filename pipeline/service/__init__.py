"""The lab's logs in one place: pages and REST over `processed/`, jobs in separate processes (extra ``serve``)."""
