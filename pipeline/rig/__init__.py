"""Design of a control loop that renders a required wall."""
