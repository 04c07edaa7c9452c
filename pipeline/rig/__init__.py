"""Design of a rig that renders a required wall."""
