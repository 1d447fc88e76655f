"""The whole numbers that every table gives back as they were written."""

#: The largest one: readers such as pandas and spreadsheets hold numbers as floats, which are exact
#: below 2**53.
LARGEST = 2**53 - 1
