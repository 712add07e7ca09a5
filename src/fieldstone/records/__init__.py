"""What a run writes about itself, as frozen dataclasses: the console, the report and every reader take these."""
