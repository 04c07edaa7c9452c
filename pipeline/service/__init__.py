"""The lab's logs in one place: pages and REST over `processed/`, jobs in processes of their own (extra ``serve``)."""
