"""Expression graphs of scalars: their `operations`, the `graph`, and `template`, traced functions made of them."""
