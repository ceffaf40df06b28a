"""Results and how they are shown: tables, pictures, HTML pages, notebooks, from plain arrays.

The only room that knows matplotlib. What a certain result says about itself (its table, picture
and page) stands in the room of that result.
"""
