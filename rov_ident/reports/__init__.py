"""Results and how they are shown: tables, pictures, HTML pages, notebooks. The only room that knows
matplotlib; what a certain result says about itself stands in its own room."""
