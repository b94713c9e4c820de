// The page's name in a tab, a bookmark and a screen reader.
document.title = 'madviz';
