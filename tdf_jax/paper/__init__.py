"""The paper's table and figures, as functions that return data; `pictures` draws them."""
