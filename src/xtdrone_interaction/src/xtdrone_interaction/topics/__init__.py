"""Topics of any type, as programs meet them that know no type beforehand: found, heard, decoded, written as JSON."""
