/**
 * Why a browser or a host does not let the simulation run, in one sentence.
 */

const REASONS = /** @type {[RegExp, string][]} */ ([
  [/Content.Security.Policy|unsafe-eval|dynamically imported module/i,
    'The Content-Security-Policy of this host forbids the simulation; it needs '
    + "script-src 'self' blob: 'unsafe-eval'."],
  [/allocate memory|out of memory|Memory\(\)/i,
    'This browser does not give the simulation the memory that it asks for, 256 MB.'],
]);

/**
 * @param {unknown} error Came while programs were started.
 * @returns {string} '' where it says nothing of that kind.
 */
export function refusal(error) {
  const words = error instanceof Error ? `${error.name}: ${error.message}` : String(error);
  return REASONS.find(([pattern]) => pattern.test(words))?.[1] ?? '';
}
