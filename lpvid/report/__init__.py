"""Reports: one self-contained HTML page, tables as text, what closing the loop found as JSON."""

from lpvid.report._loop_json import to_json as to_json
from lpvid.report._loop_json import write_json as write_json
from lpvid.report._loop_page import error_tables as error_tables
from lpvid.report._loop_page import loop_page as loop_page
from lpvid.report._loop_page import write_html as write_html
from lpvid.report._loop_words import headline as headline
from lpvid.report._loop_words import loop_text as loop_text
from lpvid.report._report import Report as Report
from lpvid.report._report import text_table as text_table
