"""Reports: HTML pages, tables on the terminal, and the commands that write them."""
