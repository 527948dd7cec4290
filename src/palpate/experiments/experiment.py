"""What every reproduction repeats."""


def suffix(label: str) -> str:
    """What is said to a person, "MPPI 10 ms", as it stands in a figure's name: mppi_10_ms."""
    return label.lower().replace(" ", "_")
