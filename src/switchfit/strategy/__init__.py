"""From a poor guess to the right answer: the strategies that `estimate` chooses among.

Each strategy is a function from a problem and a theta to the end of a search, `short_fit.End`, made of short fits;
`search` calls them in turn and asks the verdict after each (`stopping`). Belongs here: what looks for a better minimum
than one fit finds. Imports everything up to `uncertainty`, and nothing of batches, reports and files.
"""
