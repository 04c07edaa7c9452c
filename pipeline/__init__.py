"""Virtual walls under delay: step-response logs in, stability, costs and their comparison with theory out.

Nothing is imported here, so that ``import pipeline`` costs nothing; import the module of the quantity you
need (``pipeline.theory.stability.stability``, ``pipeline.measured.cost.costs``, ...). ``docs/architecture.md`` lists
them.
"""

__version__ = "0.1.0"
